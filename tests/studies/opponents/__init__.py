"""Errors in GNSS outages, beside estimators that a competent user would write."""

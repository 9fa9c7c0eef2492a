"""Known changes in real logs, as an estimator that is not told of them meets them."""

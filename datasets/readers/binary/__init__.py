"""Binary logs of autopilots."""

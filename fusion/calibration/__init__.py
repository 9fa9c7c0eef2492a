"""Self-calibration of a robot's sensors while it drives, and from several logs."""

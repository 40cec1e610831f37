"""From photographs to a calibration, and to appearances that were solved with it."""

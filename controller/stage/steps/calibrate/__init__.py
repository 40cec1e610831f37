"""Steps from photographs to a graded calibration. Entry: `full.calibration_steps`, `quick.quick_steps`, `grade`."""

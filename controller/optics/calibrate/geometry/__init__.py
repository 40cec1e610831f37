"""Poses and surface points without a known target. Entry: `self_calibration.reconstruct`."""

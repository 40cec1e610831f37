"""Poses and surface points without a known target (`self_calibration.reconstruct`); `lenses`, `intrinsics`."""

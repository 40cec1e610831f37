"""Cameras that speak PTP. Entry: `camera.DRIVER`; `still` is the camera, `body` what a maker's body does."""

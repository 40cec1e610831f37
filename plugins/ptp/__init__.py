"""Cameras with PTP. Entry: `camera.DRIVER`; `still` is the camera, `body` the behaviour of a maker's bodies."""

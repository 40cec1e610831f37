"""Cameras on a video device of Linux (V4L2): USB cameras (UVC), sensors on a board. Entry: `camera.DRIVER`."""

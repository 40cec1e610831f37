"""Cameras by libgphoto2. Entry: `camera.DRIVER`."""

"""Emulated PTP cameras, over TCP and USB. Entry: `camera`, `usb_camera`."""

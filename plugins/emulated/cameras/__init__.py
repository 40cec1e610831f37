"""Emulated PTP cameras, over TCP; the USB bus has them, too. Entry: `camera`."""

"""Reports of USB HID devices: relay boards and light sensors."""

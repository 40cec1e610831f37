"""Emulated devices and light that only engineers need: projectors, cameras, a USB bus, light by Mitsuba."""

"""Emulated devices and light that only engineers need: a USB bus, PJLink projectors, light by Mitsuba."""

"""Drivers of cameras and projectors, and the kiosk's service."""

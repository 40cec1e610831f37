"""Emulated cameras of Canon, Nikon and Sony, and a standard one. Entry: `camera`."""

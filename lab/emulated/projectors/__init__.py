"""Emulated projectors of many makers, on serial lines, LAN ports and PJLink. Entry: `boards`, `pjlink`."""

"""Projectors by serial line, LAN port, PJLink. Entry: `serial.DRIVER`, `pjlink.DRIVER`; profiles: `profile_files`."""

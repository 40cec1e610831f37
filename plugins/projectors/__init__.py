"""Projectors by serial line and PJLink. Entry: `serial.DRIVER`, `pjlink.DRIVER`; profiles by `profile_files`."""

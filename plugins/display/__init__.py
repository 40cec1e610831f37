"""The player as a display device. Entry: `player.DRIVER`."""

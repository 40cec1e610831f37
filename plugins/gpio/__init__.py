"""Keys on GPIO lines of this computer. Entry: `keys.DRIVER`."""

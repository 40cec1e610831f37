"""A stage that runs by itself: `interface.Kiosk` is its interface, `service` runs it, `serving` starts that."""

"""A stage that runs by itself: `interface.Kiosk` is what may be asked of it, `service` is what runs."""

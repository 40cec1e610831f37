"""Machine vision cameras (GenICam: GigE Vision, USB3 Vision) by Aravis. Entry: `camera.DRIVER`."""

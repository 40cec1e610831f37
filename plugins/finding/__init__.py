"""What looks for devices, one file a bus (``hal.finding``)."""

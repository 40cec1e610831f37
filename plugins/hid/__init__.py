"""USB HID devices: relays, light sensor, key panel. Entry: `DRIVER` in `relay`, `light_sensor` and
`stream_deck`.
"""

"""An emulated USB bus with HID devices on it. Entry: `bus`, `process`."""

"""Picture Transfer Protocol: `values` and `datasets`, its transports (`ip`, `usb`) and Canon's extensions
(`eos`).
"""

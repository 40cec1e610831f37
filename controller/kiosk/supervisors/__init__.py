"""One supervisor per device: it opens the device, watches it, and reopens it when it comes back. Entry point:
`devices`.
"""

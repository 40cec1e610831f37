"""Steps that take photographs: patterns, dots, the camera's own behaviour, aiming. Entry:
`photographs.take_all`, `patterns.capture_steps`.
"""

"""What changed since the last good day: `machine` and `devices` read facts, `inventory` keeps them on disk, and `watch`
takes one after each good grade and each night, and names what differs and what to do. Start at `watch`.
"""

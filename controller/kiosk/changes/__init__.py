"""What changed since the last good day: `machine` and `devices` read facts, `inventory` keeps them on disk, `compare`
names what differs and what to do, `watch` takes one after each good grade and each night. Start at `watch`.
"""

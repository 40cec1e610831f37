"""Months of a kiosk in virtual time, from one seed: its own code, in a world whose clock, threads, disk, devices and
processes are simulated. Start reading at `life`; `scheduler` makes it the same each time.
"""

"""What the kiosk keeps on disk: events, runs, bundles, settings, schedule, accounts, photographs and how long
they stay.
"""

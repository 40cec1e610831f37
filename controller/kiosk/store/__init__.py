"""What the kiosk stores on disk: events, runs, bundles, settings, schedule, accounts; and how long photographs
are kept.
"""

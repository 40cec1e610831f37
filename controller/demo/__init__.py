"""The whole job on an emulated stage, as a kiosk would do it, ending in a report."""

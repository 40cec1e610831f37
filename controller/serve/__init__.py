"""The kiosk: a stage that runs by itself, and whoever asks it something."""

"""Real devices, one file a family; plugins.emulated holds the same devices as emulators, and the bench."""

"""Light that object, table and walls throw on each other: patches, and radiosity between them. Entry: `transfers`."""

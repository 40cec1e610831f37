"""A stage in a building's show control: `verbs` is all that may be asked, `server` runs a module for each protocol."""

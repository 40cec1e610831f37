"""A stage in a building's show control: `verbs` says what may be asked, `protocol` serves them by network."""

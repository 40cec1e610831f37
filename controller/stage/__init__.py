"""A stage and the work on it: its devices (`rig`), files (`artefacts`), `steps`, `sessions`, and its `services`."""

"""A run of steps that can be stopped and resumed: `runner.Runner`, its journal, its states and its progress."""

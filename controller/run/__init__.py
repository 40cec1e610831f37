"""Runs of steps that can be stopped and resumed: `runner.Runner`, its journal, states and progress."""

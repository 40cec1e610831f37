"""State machine, journal, runner, lamp safety."""

"""What real light does beyond the ideal, one module for each effect; ``levels`` says how strong. Start at ``flaws``."""

"""Solve times: `experiment`, and the times that other papers report (`quoted`)."""

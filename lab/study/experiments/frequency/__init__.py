"""The finest sinusoid that projectors can make: `experiment`, its waves, and what the plan says of them."""

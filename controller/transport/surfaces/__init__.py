"""What surfaces make of direct light at each camera pixel: paint and spread, and the blocks of light between them."""

"""What does the heavy loops of a solve: the processor, or a graphics processor. Entry: `choice.choose_engine`."""

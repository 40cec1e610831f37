"""What solves and scales: the processor, or a graphics processor. Entry: `choice.choose_engine`."""

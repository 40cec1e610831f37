"""Live pictures from another process: `stream` reads them, `gl` and `shaders` compensate them on the GPU."""

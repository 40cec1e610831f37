"""The special behaviour of Canon EOS bodies. Entry: `body`."""

"""What Canon EOS bodies do in their own way. Entry: `body`."""

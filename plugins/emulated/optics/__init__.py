"""The optical model: what a camera sees of an object under projectors' light. Entry: `world`, `render`."""

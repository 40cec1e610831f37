"""Everything that can be asked of a kiosk, declared once: `table.OPERATIONS`; every way in is made from it."""

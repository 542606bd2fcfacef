"""How the arithmetic is laid out; nothing in this room knows of mechanics."""

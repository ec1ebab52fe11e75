"""What a part looks like besides its outline: colour, texture, and what is printed on it."""

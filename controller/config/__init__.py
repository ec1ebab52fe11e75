"""Configuration: TOML files into frozen, strict models; anything unknown, mistyped or out of range is refused."""

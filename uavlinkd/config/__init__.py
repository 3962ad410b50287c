"""A TOML file becomes an immutable :class:`.Config`, or a :class:`.ConfigError` with every problem."""

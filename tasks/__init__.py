"""Tasks: versioned TOML files; a released one never changes."""

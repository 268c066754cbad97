"""What a finished dataset promises, and whether another is the same."""

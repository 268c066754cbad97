"""What differs between operating systems and kinds of CPU."""

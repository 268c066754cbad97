"""What surrounds the program: operating systems and kinds of CPU, other machines, notebooks."""

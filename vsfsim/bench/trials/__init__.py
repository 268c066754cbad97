"""The trials of a task: what is asked, what a method answered, and the records that are scored."""

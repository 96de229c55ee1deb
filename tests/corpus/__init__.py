"""Small recordings in every dialect that is read, with a table of what each holds; ``make.py`` made them."""

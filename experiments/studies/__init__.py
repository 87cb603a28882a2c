"""What a part of the method is worth, and what it costs: a question a file, `python -m experiments.studies.NAME`."""

"""The files of a data set: written, checked, shown."""

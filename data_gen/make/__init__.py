"""Objects made by workers, until the data set is whole."""

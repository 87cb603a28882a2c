"""Which objects a data set is to hold, and in which split they are."""

"""Files of clouds, pictures and data sets, read and written."""

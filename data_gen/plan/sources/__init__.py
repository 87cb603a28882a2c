"""The data sets of others, in the layouts in which they are downloaded: which objects a folder holds."""

"""One file a data set on disk: what it is, where it comes from, its licence, its layout."""

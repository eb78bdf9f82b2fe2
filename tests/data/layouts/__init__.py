"""One writer a data set: the analytic room in the set's own files, as its documents describe them."""

"""Parts of :mod:`benchmarks.fit_speed`: each measures one thing and returns its figures."""

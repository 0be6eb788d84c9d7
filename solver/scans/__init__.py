"""Reading and checking scans: strict, because vertex order and count are the product."""

"""Places of a take's markers on a person, and the marker set that keeps them."""

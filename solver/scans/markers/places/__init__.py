"""Where a take's markers are on a person, and the marker set that says so."""

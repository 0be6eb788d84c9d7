"""A shoot day: stations that upload and look on while workers fit, and what it costs the API."""

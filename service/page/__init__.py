"""The page: what an operator sees in a browser. Static files; all data comes from the API."""

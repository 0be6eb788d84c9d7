"""Reading and checking scans."""

"""The built-in template: a head of our own making with skull and muscles."""

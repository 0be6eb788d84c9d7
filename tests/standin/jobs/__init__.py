"""Jobs that solve nothing: the setting ``jobs`` puts them in the place of the solver's."""

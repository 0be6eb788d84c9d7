"""The forward problem in one file, and solvers that run on it in processes of their own."""

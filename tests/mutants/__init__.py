"""Small wrong changes that a test must notice, and what tries them: ``python3 launch.py mutants``."""

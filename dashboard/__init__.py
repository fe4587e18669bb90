"""Campaigns, results and the user interface: the command, the service with its API, and the web pages."""

from services.system.numba_cache import provide_numba_cache

provide_numba_cache()

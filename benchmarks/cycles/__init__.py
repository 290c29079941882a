"""The stick-slip limit cycle beside transients, one and many."""

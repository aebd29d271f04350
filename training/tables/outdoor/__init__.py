"""Materials and wind: a table of what they change, and a picture."""

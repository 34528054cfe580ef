"""How often the station finds what only the twin knows."""

"""Several devices and several processes: where arrays lie, how processes meet, agree and watch one another."""

"""The tasks under other libraries' conventions; those libraries need not be installed."""

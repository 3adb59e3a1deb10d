"""Models of the reflection at the surface of skin: tables, dictionaries, mixtures, fits."""

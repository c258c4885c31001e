"""Control problems: one module each; :mod:`.problem` says what one consists of."""

"""Tables, JSON, figures and HTML pages of what the other packages find."""

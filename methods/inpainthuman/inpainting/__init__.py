"""Views that are painted: what is asked, simple fills, what comes back."""

"""Parts of peers.py: how each peer is called, the questions, and the page with the answers."""

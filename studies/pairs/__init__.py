"""Are inserted objects told apart from traced ones?  Pairs of pictures (`scene`), and a page about them with its analysis (`__main__`)."""

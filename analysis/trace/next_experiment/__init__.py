"""The experiment that would separate the explanations that remain."""

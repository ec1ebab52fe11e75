"""Hours of unattended sorting: does anything grow, slow down, get stuck or go missing?"""

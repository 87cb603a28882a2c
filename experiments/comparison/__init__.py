"""What every comparison of networks needs: trained networks, scores, tables, pictures, and a folder that resumes."""

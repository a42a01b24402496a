# metashape.py TAKE - a reconstruction hook for rigd: [reconstruct] command = /opt/metashape-pro/metashape.sh -r .../metashape.py
#
# Aligns TAKE/linear/*.exr, builds a mesh with a UV atlas and leaves TAKE/geometry/mesh.obj and TAKE/geometry/cameras.xml, which rigsolve reads.
# Coded targets with known distances (markers.csv beside the takes: label1, label2, metres) give the scale.
# NOT RUN HERE: written from Metashape's Python API reference (2.x); it needs a licence. Try it by hand on one take before rigd uses it.
import csv
import glob
import os
import sys

import Metashape

take = sys.argv[-1]
geometry = os.path.join(take, "geometry")
pictures = sorted(glob.glob(os.path.join(take, "linear", "*.exr")))
if len(pictures) < 3:
    sys.exit("error: metashape.py: %d pictures in %s/linear; expected 3 or more" % (len(pictures), take))

document = Metashape.Document()
chunk = document.addChunk()
chunk.addPhotos(pictures)
for camera in chunk.cameras:  # one body each: its own lens
    sensor = chunk.addSensor(camera.sensor)
    camera.sensor = sensor
chunk.detectMarkers(target_type=Metashape.CircularTarget12bit)
chunk.matchPhotos(downscale=1, generic_preselection=True)
chunk.alignCameras()
lengths = os.path.join(os.path.dirname(take.rstrip("/")), "markers.csv")
if os.path.exists(lengths):
    marker = {m.label: m for m in chunk.markers}
    for first, second, metres in csv.reader(open(lengths)):
        if first in marker and second in marker:
            bar = chunk.addScalebar(marker[first], marker[second])
            bar.reference.distance = float(metres)
            bar.reference.enabled = True
    chunk.updateTransform()
lost = [c.label for c in chunk.cameras if not c.transform]
if len(lost) > len(pictures) // 2:
    sys.exit("error: metashape.py: %d of %d cameras could not be placed: %s" % (len(lost), len(pictures), ", ".join(lost)))
chunk.buildDepthMaps(downscale=2)
chunk.buildModel(source_data=Metashape.DepthMapsData, face_count=Metashape.MediumFaceCount)
chunk.buildUV(mapping_mode=Metashape.GenericMapping)
os.makedirs(geometry, exist_ok=True)
chunk.exportModel(os.path.join(geometry, "mesh.obj"), save_texture=False, save_colors=False)
chunk.exportCameras(os.path.join(geometry, "cameras.xml"))

@echo off
rem realitycapture.bat TAKE - a reconstruction hook for a Windows machine that sees the takes' folder (RealityCapture runs on nothing else).
rem
rem rigd runs on Linux: start this there by ssh, for example [reconstruct] command = ssh windows-host C:\studiorig\realitycapture.bat - with
rem the takes' folder shared under the path that is given, or map it below. Leaves geometry\mesh.obj and one .xmp per picture in
rem geometry\cameras, which rigsolve reads.
rem NOT RUN HERE: written from RealityCapture's command-line reference; it needs Windows and a licence. Try it by hand on one take first.
setlocal
set TAKE=%~1
if "%TAKE%"=="" (echo error: usage: realitycapture.bat TAKE& exit /b 2)
if not exist "%TAKE%\geometry\cameras" mkdir "%TAKE%\geometry\cameras"
"C:\Program Files\Capturing Reality\RealityCapture\RealityCapture.exe" -headless -set "appQuitOnError=true" ^
  -addFolder "%TAKE%\linear" -align -selectMaximalComponent -exportXMP ^
  -setReconstructionRegionAuto -calculateNormalModel -simplify 500000 -unwrap ^
  -exportModel "Model 1" "%TAKE%\geometry\mesh.obj" -quit
if errorlevel 1 (echo error: RealityCapture failed& exit /b 1)
move /y "%TAKE%\linear\*.xmp" "%TAKE%\geometry\cameras\" >nul
if not exist "%TAKE%\geometry\mesh.obj" (echo error: no mesh was made& exit /b 1)
exit /b 0

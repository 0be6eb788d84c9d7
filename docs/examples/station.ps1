# A capture station in PowerShell (5.1, as Windows has it, or 7): every scan that the scanner saves is
# sent, checked, and judged in a line.
#
#     $env:MYOFACE_API_KEY = 'myo_...'
#     powershell -File station.ps1 C:\scans -Url https://faces.example.com
#
# Each folder in C:\scans is a person, each OBJ, PLY, GLB or STL in it a raw scan, named like its file;
# one with neutral or rest as a word of its name is the neutral. Scan again into the same file, and the
# new one takes the old one's place. A file goes in one piece: a line that breaks costs the file anew.
param(
    [Parameter(Mandatory = $true)][string]$Folder,
    [string]$Url = 'http://127.0.0.1:8765',
    [switch]$Once
)
$ErrorActionPreference = 'Stop'
$Key = @{ Authorization = "Bearer $env:MYOFACE_API_KEY" }
$Done = @{}

function Invoke-Api($Method, $Path, $Body) {
    $request = @{ Method = $Method; Uri = "$Url$Path"; Headers = $Key; UseBasicParsing = $true }
    if ($Body) {
        $request.Body = [Text.Encoding]::UTF8.GetBytes((ConvertTo-Json $Body -Depth 5))
        $request.ContentType = 'application/json'
    }
    Invoke-RestMethod @request
}

function ConvertTo-Base64($Text) { [Convert]::ToBase64String([Text.Encoding]::UTF8.GetBytes($Text)) }

function Send-File($File, $Sha256) {
    $about = @{
        'Upload-Length' = "$($File.Length)"
        'Upload-Metadata' = "filename $(ConvertTo-Base64 $File.Name),sha256 $(ConvertTo-Base64 $Sha256)"
    }
    $upload = Invoke-RestMethod -Method Post -Uri "$Url/v1/uploads" -Headers ($Key + $about) -UseBasicParsing
    $null = Invoke-WebRequest -Method Patch -Uri "$Url/v1/uploads/$($upload.id)" -InFile $File.FullName `
        -Headers ($Key + @{ 'Upload-Offset' = '0' }) -ContentType 'application/offset+octet-stream' -UseBasicParsing
    $upload.id
}

# A legal name: accents go, what is no letter, digit, _, - or . becomes _, and 64 characters stay.
function Get-ScanName($File) {
    $plain = $File.BaseName.Normalize([Text.NormalizationForm]::FormD) -replace '\p{Mn}', ''
    $name = $plain -creplace '[^A-Za-z0-9_.-]+', '_' -creplace '^[^A-Za-z0-9]+|[^A-Za-z0-9]+$', ''
    if (-not $name) { throw 'no name can be made of it: a letter of a to z or a digit is needed' }
    $name.Substring(0, [Math]::Min(64, $name.Length))
}

function Test-Neutral($File) { $File.BaseName -match '(?<![A-Za-z])(neutral|neutre|rest|relaxed)(?![A-Za-z])' }

function Get-SubjectId($Person) {
    $note = Join-Path $Person.FullName '.myoface-subject'
    if (-not (Test-Path $note)) {
        Set-Content $note (Invoke-Api Post '/v1/subjects' @{ name = $Person.Name }).id
    }
    (Get-Content $note -TotalCount 1).Trim()
}

function Submit-Scan($File) {
    $name = Get-ScanName $File
    $sha256 = (Get-FileHash $File.FullName -Algorithm SHA256).Hash.ToLower()
    $subject = Get-SubjectId $File.Directory
    $captures = "/v1/subjects/$subject/captures"
    $scan = (Invoke-Api Get "${captures}?limit=1000").items | Where-Object { $_.name -eq $name }
    if (-not $scan -or $scan.sha256 -ne $sha256) {
        $new = @{ name = $name; role = 'expression'; upload_id = Send-File $File $sha256 }
        if (Test-Neutral $File) { $new.role = 'neutral' }
        if ($scan) { $new.replaces = $scan.id }
        $scan = Invoke-Api Post $captures $new
    }
    $job = "/v1/jobs/$([guid]::NewGuid())" # our own id: sent twice, it is still one job
    $check = Invoke-Api Put $job @{ kind = 'check_scan'; subject_id = $subject; captures = @($scan.id) }
    while ($check.state -notin 'succeeded', 'failed', 'canceled') {
        Start-Sleep -Milliseconds 500
        $check = Invoke-Api Get $job
    }
    if ($check.state -ne 'succeeded') { throw "the check has $($check.state)" }
    Write-Host "$($File.FullName): $($check.result.summary.verdict)"
    foreach ($finding in $check.result.summary.findings) {
        Write-Host "    $($finding.message): $($finding.advice)"
    }
}

do {
    $scans = Get-ChildItem $Folder -Recurse -File | Where-Object { $_.Extension -in '.obj', '.ply', '.glb', '.stl' }
    foreach ($file in $scans | Sort-Object @({ -not (Test-Neutral $_) }, 'FullName')) {
        $saved = $file.LastWriteTimeUtc
        if ($Done[$file.FullName] -eq $saved -or ([DateTime]::UtcNow - $saved).TotalSeconds -lt 2) { continue }
        try {
            Submit-Scan $file
            $Done[$file.FullName] = $saved
        } catch {
            Write-Host "$($file.FullName): $(if ($_.ErrorDetails) { $_.ErrorDetails.Message } else { $_ })"
        }
    }
    Start-Sleep 1
} until ($Once)
